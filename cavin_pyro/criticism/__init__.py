"""Criticism of a trained model and its guide: accuracy of the inference, and errors of the model."""
