"""Functions of a user's own, `module:function`: known by a digest from when a scene is read.

In `function`, `resolve` finds one, and `use` hands it to what calls it, where code of the user's may run. In `trial`,
`tried` calls one in children first.
"""
