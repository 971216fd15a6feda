"""Whether a result may be trusted: held-out frames, verdict, targets."""
