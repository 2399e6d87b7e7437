"""What a run records, kept in order on the disk until its tracking store has it."""
