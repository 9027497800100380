"""Stone Soup: detections, tracks, sensors, and a measurement model of any declared sensor (`probcal[stonesoup]`)."""
