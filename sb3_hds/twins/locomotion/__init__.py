"""Twins of Gymnasium's MuJoCo tasks, on MuJoCo's engine."""
