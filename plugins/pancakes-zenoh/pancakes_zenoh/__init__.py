"""Links between Pancakes agents through Zenoh routers."""
