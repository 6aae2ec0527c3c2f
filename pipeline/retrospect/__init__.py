"""Retrospect: one answer for the mission as a whole, given all that was detected."""
