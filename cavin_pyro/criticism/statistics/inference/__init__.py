"""Whether the guide is right: importance weights, information, simulation-based calibration."""
