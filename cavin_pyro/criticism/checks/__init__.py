"""One check of a trained model and its guide per file."""
