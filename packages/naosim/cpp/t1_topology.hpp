// Written by topology.py; included by humanoid_model.hpp within its namespace.
constexpr int kBodies = 24, kGeoms = 12;
constexpr int kLeftFoot = 17, kRightFoot = 23;
constexpr int kParent[] = {-1, 0, 1, 0, 3, 4, 5, 0, 7, 8, 9, 0, 11, 12, 13, 14, 15, 16, 11, 18, 19, 20, 21, 22};
constexpr int kAxis[] = {0, 2, 1, 1, 0, 1, 2, 1, 0, 1, 2, 2, 1, 0, 2, 1, 1, 0, 1, 0, 2, 1, 1, 0};
constexpr int kGeomBody[] = {0, 2, 5, 6, 9, 10, 13, 15, 17, 19, 21, 23};
constexpr int kGeomShape[] = {6, 2, 3, 3, 3, 3, 3, 3, 6, 3, 3, 6};
// Bodies of the arms, and of hips and waist: the pattern "arms" has their products.
constexpr bool kArm[] = {0, 0, 0, 1, 1, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0};
constexpr bool kHip[] = {0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 0, 0, 0, 0, 1, 1, 0, 0, 0, 0};
