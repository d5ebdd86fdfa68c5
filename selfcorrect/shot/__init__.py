"""A shot: what a frame starts from, frames read ahead and written behind, states on disk."""
