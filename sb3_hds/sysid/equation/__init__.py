"""Equation errors in weak form: which causes explain the force that a model lacks, all at once."""
