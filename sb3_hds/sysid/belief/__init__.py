"""What the data leave open: the answers that they cannot tell apart, and a belief over them."""
