"""Hybrid differentiable simulation: planning in a model that measured data correct."""
