"""Training: the trainer, its objectives, and the pretraining of the PointNet."""
