"""Datasets on disk: collection, windows, features, held-out objects, summaries."""
