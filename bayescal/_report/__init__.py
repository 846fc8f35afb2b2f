"""What is shown and kept of a result: result.json, its folder, pictures, tables, the report."""
