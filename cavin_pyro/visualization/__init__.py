"""Figures, videos and recordings."""
