"""From anyone's mesh to a tool."""
