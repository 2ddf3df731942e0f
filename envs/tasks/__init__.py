"""One file each task; configs/task/<name>.yaml names the class."""
