"""Against the truth: reflector targets or a simulator's answer, and the paper's tables."""
