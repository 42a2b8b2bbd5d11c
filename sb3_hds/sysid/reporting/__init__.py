"""Presentation of a diagnosis: sentence, table, page, figures, film."""
