"""Priors of the codes, p(c | s) and p(z | s, c)."""
