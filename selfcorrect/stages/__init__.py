"""Stages around the core that need no pretrained weights: each a function on tensors, one idea a file."""
