"""Whether a result may be trusted: held-out frames, errors at targets, verdict."""
