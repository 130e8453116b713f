"""Automatic assessment of a reconstruction: evidence from the images, and a grade with reasons."""
