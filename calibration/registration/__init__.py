"""Where each pixel of one exposure lies in another."""
