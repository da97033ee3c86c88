"""Controls: sources of networks that learn nothing, which every learned method has to beat or explain."""
