"""How agents meet, and hand tasks over."""
