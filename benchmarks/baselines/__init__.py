"""Policies that learn from the same episodes by other means, and faults that all have to bear."""
