"""Files as tables: headers and cells as they are, and their faults; columns are matched later."""
