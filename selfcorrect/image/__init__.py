"""Pieces of an image: bands of rows, windows, exposure."""
