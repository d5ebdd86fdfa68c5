"""The stage that the project is named for: a network optimised on the frame itself (Back et al. 2022)."""
