"""Transforms of actions and observations, shared by environments and twins."""
