"""What a posterior density is defined by."""
