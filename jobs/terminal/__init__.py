"""Terminal output of commands: logs, progress, tables, the summary line."""
