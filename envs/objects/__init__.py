"""Objects to push: what they are, which sets there are, and how a scene samples them."""
