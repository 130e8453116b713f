"""Distributions made from others: rounded and clipped, or completed by quadrature."""
