"""Hypotheses judged by simulation: fits and searches, what predicts better, what looks alike."""
