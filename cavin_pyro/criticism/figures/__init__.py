"""Figures of the report, without statistics."""
