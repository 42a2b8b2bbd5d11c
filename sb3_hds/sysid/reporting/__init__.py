"""How a diagnosis is told: sentence, table, page, pictures, film."""
