"""The commands' configuration."""
