"""What several studies, or one that is long, are made of."""
