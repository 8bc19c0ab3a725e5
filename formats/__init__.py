"""What `lifelong_slam` and `eval` share: files from elsewhere, which may be damaged or made to harm."""
