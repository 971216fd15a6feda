"""Networks that perception uses, trained weakly from the other sensors."""
