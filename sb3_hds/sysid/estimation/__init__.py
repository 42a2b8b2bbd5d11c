"""
Parameters from data: windows, shooting, covariance and intervals.

What they leave is learned as a force.
"""
