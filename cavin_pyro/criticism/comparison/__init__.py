"""Two checkpoints side by side, on the same held-out windows."""
