"""How a command is told what to do: composition of options, one-line errors, and the parts that they name."""
