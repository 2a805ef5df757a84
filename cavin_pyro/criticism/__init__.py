"""Criticism of a trained model and its guide: whether the inference can be trusted, and what the model gets wrong."""
