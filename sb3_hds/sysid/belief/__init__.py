"""What the data leave open: the answers that they cannot distinguish, and a belief over them."""
