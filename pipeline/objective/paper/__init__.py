"""The paper's losses, pair by pair, and the loop that joins them."""
