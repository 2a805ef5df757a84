"""Objects to push: shapes, sets of objects, and their sampling in a scene."""
