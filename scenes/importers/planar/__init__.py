"""A film of one colour camera, of a motion in a plane, to a scene: a rope before a board, a strip on a table."""
