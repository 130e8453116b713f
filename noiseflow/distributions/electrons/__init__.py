"""Shot plus read noise in electrons, k + read_noise·n: each module computes it where its method is fastest."""
