"""Algorithms that plan in a differentiable simulation and regress the policy on the plans."""
