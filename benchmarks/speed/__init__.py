"""Speed of a batch of filters beside the same filter written by others and by hand."""
