"""Options of the commands: declaration, composition, one-line errors, and construction of the parts."""
