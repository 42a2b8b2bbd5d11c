"""
Parameters from data: windows, multiple shooting, covariance and intervals.

The residual force is learned by a network.
"""
