// A nodelet manager that loads its nodelets itself, so that the whole pipeline is one process.
//
// With `nodelet load` every nodelet has a process of its own beside the manager's, and when either
// dies the nodelet is gone until both have noticed. Here roslaunch starts one process again, and
// everything in it.

#include <nodelet/loader.h>
#include <ros/ros.h>

#include <string>

int main(int argc, char** argv) {
  ros::init(argc, argv, "pipeline");
  const ros::V_string arguments(argv + 1, argv + argc);
  nodelet::Loader loader(ros::NodeHandle("~"));
  bool any = false;
  for (const std::string& argument : arguments) {
    const std::size_t at = argument.find('=');
    if (at == std::string::npos || argument.find(":=") != std::string::npos) continue;
    const std::string name = ros::names::resolve(argument.substr(0, at));
    // Remappings of the process hold for all its nodelets.
    if (!loader.load(name, argument.substr(at + 1), ros::names::getRemappings(), {})) {
      ROS_FATAL("%s could not be loaded: the reason stands above", name.c_str());
      return 1;
    }
    any = true;
  }
  if (!any) {
    ROS_FATAL("usage: pipeline_node NAME=PACKAGE/NODELET...; the first is loaded first");
    return 2;
  }
  ros::spin();
  return 0;
}
