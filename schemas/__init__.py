"""Tables: columns with units, versions, and row types."""
