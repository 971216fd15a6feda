"""What several methods share: searches, response surfaces, covariance, bias floors."""
