"""Building a zoo: expert, GHNs distilled from it, selection by scores, packing."""
