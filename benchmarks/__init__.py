"""Speed and memory against the naive way and the floor; ``make bench`` prints them."""
