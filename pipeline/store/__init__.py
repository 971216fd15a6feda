"""Storage of tables; no other package reads or writes them."""
