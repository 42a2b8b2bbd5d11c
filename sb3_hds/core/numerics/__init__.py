"""Integrators, small linear systems, and compilation by XLA."""
