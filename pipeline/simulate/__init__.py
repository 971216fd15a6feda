"""A synthetic fleet with exact truth, written as real logs. Nothing in the estimator imports from here."""
