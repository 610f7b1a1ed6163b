"""Pictures of a recording that still grows."""
