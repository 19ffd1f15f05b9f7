"""Sessions: folders of captured frames that neither a crash nor a power cut can spoil."""
