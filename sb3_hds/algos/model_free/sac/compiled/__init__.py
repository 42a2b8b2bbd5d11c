"""Learning of the SAC family with several seeds in one compiled program."""
