"""Activations, widths and optimisers of networks, and observations as networks see them."""
