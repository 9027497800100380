"""Associations drawn from their posterior by Markov chains."""
