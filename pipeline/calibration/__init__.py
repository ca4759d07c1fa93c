"""Calibration: what a machine file holds, told from logs made for it."""
