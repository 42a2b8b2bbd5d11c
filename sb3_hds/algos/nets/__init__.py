"""Building blocks of networks, their optimisers, and observations as networks see them."""
