"""Dynamic RRT (Ferguson, Kalra and Stentz 2006): a tree rooted at the goals that is trimmed where obstacles changed."""
