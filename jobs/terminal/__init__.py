"""What commands show: logs, progress, tables, the last line."""
