"""Conversion of folders of public data sets to logs that ingest reads."""
