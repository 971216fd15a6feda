"""What the tables hold: columns with units, versions, and the row types that the stages exchange."""
