"""The stages of Boresight. Import directions: schemas <- pipeline <- jobs; stage folders don't import each other."""
