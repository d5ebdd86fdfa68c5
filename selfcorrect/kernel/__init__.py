"""The windowed kernels, a folder each: what validates and dispatches, the readable reference, the compiled form."""
