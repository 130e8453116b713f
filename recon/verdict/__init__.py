"""How far to trust a reconstruction: evidence from the images, and a grade with its reasons."""
