"""The families of generated hand tools: hammers, pliers, screwdrivers, wrenches."""
