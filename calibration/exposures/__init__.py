"""Frames, exposure pairs and bursts, with their masks and scaling."""
