// Draws what stage 1 makes of the scans of a bag: one PNG per scan, the labels over the ranges.

#include <CLI/CLI.hpp>
#include <fmt/format.h>
#include <opencv2/core.hpp>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>
#include <sensor_msgs/PointCloud2.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <stdexcept>
#include <string>
#include <utility>

#include "dendro_slam/range_image/projector.h"
#include "dendro_slam/ros/bag.h"
#include "dendro_slam/ros/markers.h"
#include "dendro_slam/ros/point_cloud2.h"
#include "dendro_slam/segmentation/wood_segmenter.h"

namespace {

struct Options {
  std::string bag;
  std::string topic;
  std::string folder;
  int every = 10;
  int strips = 2;
  dendro::ProjectorConfig projector;
  dendro::WoodSegmenterConfig segmenter;
};

constexpr int kRowPixels = 10;    // Height of a ring in the picture.
constexpr int kColumnPixels = 2;  // Width of a column.
constexpr int kGap = 6;

// Near is bright, nothing is black.
cv::Vec3b RangeColor(float range_m) {
  const float shade = 255.0F - 60.0F * std::log2(std::max(range_m, 0.5F) / 0.5F) * 0.75F;
  const auto value = static_cast<std::uint8_t>(std::clamp(shade, 25.0F, 255.0F));
  return {value, value, value};
}

// Labels above ranges, the revolution cut into strips that lie below each other, highest ring first.
cv::Mat Draw(const dendro::LabelledScan& scan, int strips) {
  const dendro::RangeImage& image = scan.image;
  cv::Mat labels(image.rows, image.cols, CV_8UC3, cv::Scalar::all(0));
  cv::Mat ranges = labels.clone();
  for (int row = 0; row < image.rows; ++row) {
    for (int col = 0; col < image.cols; ++col) {
      const std::size_t pixel = image.Index(row, col);
      if (!image.HasReturn(pixel)) continue;
      const auto rgb = dendro_ros::LabelColor(scan.label[pixel]);
      labels.at<cv::Vec3b>(image.rows - 1 - row, col) = {rgb[2], rgb[1], rgb[0]};
      ranges.at<cv::Vec3b>(image.rows - 1 - row, col) = RangeColor(image.range[pixel]);
    }
  }
  const int width = (image.cols + strips - 1) / strips;
  const int height = image.rows * kRowPixels;
  cv::Mat picture(
      strips * 2 * (height + kGap), width * kColumnPixels, CV_8UC3, cv::Scalar(60, 60, 60));
  for (int strip = 0; strip < strips; ++strip) {
    const cv::Range columns(strip * width, std::min((strip + 1) * width, image.cols));
    if (columns.empty()) break;
    int y = strip * 2 * (height + kGap);
    for (const cv::Mat& part : {labels.colRange(columns), ranges.colRange(columns)}) {
      cv::Mat target = picture(cv::Rect(0, y, columns.size() * kColumnPixels, height));
      cv::resize(part, target, target.size(), 0, 0, cv::INTER_NEAREST);
      y += height + kGap / 2;
    }
  }
  return picture;
}

void Run(const Options& options) {
  const dendro_ros::BagReader bag(options.bag);
  const std::string topic = bag.ChooseTopic(options.topic,
                                            {"/velodyne_points", "velodyne_points"},
                                            "sensor_msgs/PointCloud2",
                                            "scans",
                                            true);
  std::filesystem::create_directories(options.folder);
  dendro::Projector projector(options.projector);
  dendro::WoodSegmenter segmenter(options.segmenter);
  int index = 0;
  int written = 0;
  bag.ForEach({topic}, [&](const rosbag::MessageInstance& message) {
    const auto cloud = message.instantiate<sensor_msgs::PointCloud2>();
    if (!cloud || index++ % options.every != 0) return;
    const dendro::LidarScan scan = dendro_ros::ReadPointCloud2(*cloud, topic);
    if (scan.points.empty()) return;
    const dendro::LabelledScan labelled = segmenter.Segment(projector.Project(scan, nullptr));
    const auto count = [&](dendro::Label label) {
      return std::count(labelled.label.begin(), labelled.label.end(), label);
    };
    const std::string name =
        (std::filesystem::path(options.folder) / fmt::format("scan_{:05d}.png", index - 1)).string();
    if (!cv::imwrite(name, Draw(labelled, options.strips))) {
      throw std::runtime_error("cannot write " + name);
    }
    ++written;
    fmt::print("{}: {} ground, {} wood, {} leaf, {} other\n",
               name,
               count(dendro::Label::kGround),
               count(dendro::Label::kWood),
               count(dendro::Label::kLeaf),
               count(dendro::Label::kOther));
  });
  if (written == 0) throw std::runtime_error(options.bag + ": no scan with points in " + topic);
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app("Draws the labels of stage 1 over the ranges, one PNG per scan: green leaf, brown "
               "ground, orange wood, blue other. The sweep's motion is not removed.");
  Options options;
  app.add_option("IN", options.bag, "bag with scans (pcap_to_bag makes one of a capture)")->required();
  app.add_option("-o,--output", options.folder, "folder for the pictures")->required();
  app.add_option("--topic", options.topic, "of the scans; default: the only one, or velodyne_points");
  app.add_option("--every", options.every, "draws every n-th scan")->check(CLI::PositiveNumber);
  app.add_option("--strips", options.strips, "parts that a revolution is cut into")
      ->check(CLI::Range(1, 16));
  app.add_option("--method", options.segmenter.method, "network or geometric");
  app.add_option("--weights", options.segmenter.weights, "weights file; default: the shipped one");
  app.add_option("--model", options.projector.model, "vlp16 or uniform");
  app.add_option("--rows", options.projector.rows);
  app.add_option("--cols", options.projector.cols);
  CLI11_PARSE(app, argc, argv);
  try {
    Run(options);
  } catch (const std::exception& error) {
    fmt::print(stderr, "label_bag: {}\n", error.what());
    return 1;
  }
  return 0;
}
