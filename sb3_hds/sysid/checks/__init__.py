"""What is asked of a log before and beside any cause: its conventions, its clock, its constancy."""
