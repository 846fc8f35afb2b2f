"""The workbench: the loop in a browser. A face: everything that it does is a public function of `bayescal`."""
