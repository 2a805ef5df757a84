"""What sections conclude, and the words that they use."""
