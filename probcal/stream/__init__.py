"""Streams of rows, calibrated as they come: filters, watches over the sensors, states that survive a kill."""
