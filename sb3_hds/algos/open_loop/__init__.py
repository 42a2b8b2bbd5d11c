"""Open-loop oscillators whose constants a black-box search finds."""
