"""Storage on disk: atomic writes, run directories, provenance, checkpoints."""
