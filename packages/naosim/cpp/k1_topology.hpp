// Written by topology.py; included by humanoid_model.hpp within its namespace.
constexpr int kBodies = 23, kGeoms = 20;
constexpr int kLeftFoot = 16, kRightFoot = 22;
constexpr int kParent[] = {-1, 0, 1, 0, 3, 4, 5, 0, 7, 8, 9, 0, 11, 12, 13, 14, 15, 0, 17, 18, 19, 20, 21};
constexpr int kAxis[] = {0, 2, 1, 1, 0, 1, 2, 1, 0, 1, 2, 1, 0, 2, 1, 1, 0, 1, 0, 2, 1, 1, 0};
constexpr int kGeomBody[] = {0, 0, 1, 2, 4, 5, 6, 8, 9, 10, 12, 13, 14, 14, 16, 18, 19, 20, 20, 22};
constexpr int kGeomShape[] = {6, 5, 7, 7, 5, 7, 7, 5, 7, 7, 5, 5, 5, 6, 6, 5, 5, 5, 6, 6};
// Bodies of the arms, and of hips and waist: the pattern "arms" has their products.
constexpr bool kArm[] = {0, 0, 0, 1, 1, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0};
constexpr bool kHip[] = {0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 0, 0, 0, 1, 1, 1, 0, 0, 0};
