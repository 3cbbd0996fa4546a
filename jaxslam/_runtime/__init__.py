"""What is no mathematics: files, kept programs, progress, look-ups, and the end of a hang."""
