"""What is kept on disk: atomic writes, run directories, provenance, checkpoints."""
