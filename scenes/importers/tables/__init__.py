"""Tables of markers: what motion capture programs export, and plain columns and arrays, to scenes."""
