"""Tilt series: read, aligned, screened and checked."""
