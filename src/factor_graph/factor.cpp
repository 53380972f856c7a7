#include "dendro_slam/factor_graph/factor.h"

namespace dendro {

namespace {

std::vector<const Value*> Resolve(const Factor& factor, const Values& values) {
  std::vector<const Value*> out;
  for (const Key key : factor.keys()) out.push_back(&values.Get(key));
  factor.CheckTypes(out.data());
  return out;
}

}  // namespace

std::string Factor::Describe() const {
  std::string out = Kind();
  for (const Key key : keys()) out += " " + KeyName(key);
  return out;
}

double Factor::Error(const Values& values) const { return Error(Resolve(*this, values).data()); }

double Factor::Linearize(const Values& values,
                         Eigen::MatrixXd* jacobian,
                         Eigen::VectorXd* residual) const {
  const std::vector<const Value*> pointers = Resolve(*this, values);
  int columns = 0;
  for (const Value* value : pointers) columns += TangentDimension(*value);
  jacobian->resize(dimension(), columns);
  residual->resize(dimension());
  return Linearize(pointers.data(), jacobian->data(), residual->data());
}

}  // namespace dendro
