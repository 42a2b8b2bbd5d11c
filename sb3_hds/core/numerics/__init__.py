"""Integrators, small linear systems, and how programs are compiled."""
