"""What the commands that draw have in common: which scalar is seen how, from where, and what is written of it."""
