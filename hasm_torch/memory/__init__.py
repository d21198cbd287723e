"""The hetero-associative sequential memory: storing, binding and recall."""
