"""From joint positions and skin forces to bipolar codes: one equation a file."""
