"""One module or room for each kind of observation: its residual, and its factor or batch in the graph.

What is new to observe begins here; how the graph is put together and solved does not belong here.
"""
