"""Repair of a guide that fails simulation-based calibration."""
