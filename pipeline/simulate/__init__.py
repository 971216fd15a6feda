"""A synthetic fleet with exact truth, from models of roads and sensors; the estimator never imports it."""
