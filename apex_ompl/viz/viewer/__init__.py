"""The viewer: scenes, motions and plans in a browser, live or as pages that play offline."""
