"""Rigid-body dynamics of trees of links, with derivatives."""
