"""What stands on the table, where it belongs, and how it is scored."""
